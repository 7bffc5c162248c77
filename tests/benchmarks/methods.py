"""The methods under a torque law, as settings of an integrator."""

FORCED = {
    "order 2": {},
    "composition 4": {"order": 4, "force_gradient": False},
    "force gradient 4": {"order": 4},
    "composition 6": {"order": 6},
    "composition 8": {"order": 8},
}
