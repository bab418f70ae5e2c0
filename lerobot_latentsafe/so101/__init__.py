"""A simulated SO-101 that pushes a cube along a table; no LeRobot here."""
