"""The exact motion of a body without torque, at any times, without steps."""
