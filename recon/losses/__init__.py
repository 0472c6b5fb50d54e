"""What a rendering and a motion are held against: a tuple of objects with weights."""
