"""Presentation of the pipeline's results: rerun recording, pictures, reports."""
