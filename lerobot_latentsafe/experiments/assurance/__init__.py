"""What can be promised of a filter: how often it misses, and whether it says that the scene is new."""
