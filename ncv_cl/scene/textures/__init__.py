"""Images on surfaces: from files to texels, and from texels to what a surface is made of at a point."""
