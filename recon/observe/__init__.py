"""How a camera sees the scene: effects on the light, and views with their backgrounds."""
