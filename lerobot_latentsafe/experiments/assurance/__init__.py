"""How far what is promised of a filter holds."""
