"""Mass, centre of mass and inertia of bodies, in and out."""
