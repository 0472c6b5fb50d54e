"""The folder of a reconstruction, and ways to show it: images, video, exports, the report page."""
