"""Force laws: what moves the centre of mass, and what an accelerometer feels."""
