"""The questions of the report: each a function from the parts' numbers to an answer."""
