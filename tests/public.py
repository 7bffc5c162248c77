"""What a module offers to users."""

from types import ModuleType

from lgvi import so3


def public_names(module: ModuleType) -> list[str]:
    """Names that a package imports for its users; modules are none of them, but for `so3`."""
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and (value is so3 or not isinstance(value, ModuleType))
    ]
