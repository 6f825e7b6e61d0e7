"""Commands of `ncv-cl` with their arguments, beside `render` and what is about networks."""
