def write_compare_report(directory): pass
