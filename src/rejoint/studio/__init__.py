"""The studio: a page that leads an owner through a repair. Only the command line knows this room."""
