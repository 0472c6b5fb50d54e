"""The folder that a reconstruction is kept in, and what is shown of it: images, video, exports, the report page."""
