"""HTML pages of runs, comparisons, batches and landmark studies."""
