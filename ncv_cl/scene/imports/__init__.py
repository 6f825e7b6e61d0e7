"""Scene files of every kind as the tables of our own: TOML, mesh files, Mitsuba's XML.

What a file has that cannot be shown is said by kind and count. `Found` goes on as a TOML file does.
"""

from .found import Found
from .read import SCENE_KINDS, read_tables

__all__ = ["SCENE_KINDS", "Found", "read_tables"]
