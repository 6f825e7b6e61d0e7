"""Commands of ncv-cl that have a file of their own."""
