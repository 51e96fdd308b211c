def record_comparison(directory): pass
