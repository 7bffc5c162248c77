"""One step of the free rigid body: its equation, the root and the derivative of the root."""
