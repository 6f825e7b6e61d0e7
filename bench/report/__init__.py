"""The benchmark report: from the parts' JSON files to one HTML file and the same as Markdown."""
