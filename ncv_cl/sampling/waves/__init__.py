"""Rays of one bounce of all paths: memory for them, who traces them, how many there are."""
