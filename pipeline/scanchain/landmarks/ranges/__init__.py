"""Range and bearing logs (MRCLAM): noise and state estimated together."""
