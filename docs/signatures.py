"""Griffe extensions, used by mkdocs.yml to read the signatures of this library."""

import griffe

MAKE_INIT = {"equinox.Module", "typing.NamedTuple"}


class FieldSignatures(griffe.Extension):
    """Constructors of Equinox modules and named tuples, which are made from their fields.

    A class that users do not make themselves documents no parameters, and shows no constructor.
    """

    def on_class(self, *, cls: griffe.Class, **kwargs) -> None:
        if cls.docstring is None or "Parameters\n" not in cls.docstring.value:
            return
        fields = [
            member
            for member in cls.members.values()
            if member.is_attribute
            and member.annotation is not None
            and "property" not in member.labels
            and "AbstractVar" not in str(member.annotation)
        ]
        if not fields or "__init__" in cls.members or not self._makes_init(cls):
            return
        kind = griffe.ParameterKind.positional_or_keyword
        parameters = [griffe.Parameter("self", kind=kind)] + [
            griffe.Parameter(
                field.name, annotation=field.annotation, kind=kind, default=default(field)
            )
            for field in fields
        ]
        init = griffe.Function("__init__", parameters=griffe.Parameters(*parameters), parent=cls)
        cls.set_member("__init__", init)

    def _makes_init(self, cls: griffe.Class) -> bool:
        for base in cls.bases:
            path = base if isinstance(base, str) else base.canonical_path
            if path in MAKE_INIT or path.rpartition(".")[2].startswith("Abstract"):
                return True
        return False


def default(field: griffe.Attribute):
    """The default of `name: type = value` or `name: type = eqx.field(default=value)`."""
    if isinstance(field.value, griffe.ExprCall) and field.value.canonical_path == "equinox.field":
        keywords = [a for a in field.value.arguments if isinstance(a, griffe.ExprKeyword)]
        return next((a.value for a in keywords if a.name == "default"), None)
    return field.value


class ShapeStrings(griffe.Extension):
    """Keep `Float[Array, "3"]` as written: Griffe takes the shape "3" for the number 3."""

    def on_function(self, *, func: griffe.Function, **kwargs) -> None:
        for annotation in (func.returns, *(parameter.annotation for parameter in func.parameters)):
            quote_shapes(annotation)

    def on_attribute(self, *, attr: griffe.Attribute, **kwargs) -> None:
        quote_shapes(attr.annotation)


def quote_shapes(annotation) -> None:
    if not isinstance(annotation, griffe.Expr):
        return
    if isinstance(annotation, griffe.ExprSubscript) and str(annotation.left) in ("Float", "Bool"):
        *_, shape = annotation.slice.elements
        if not str(shape).startswith(("'", '"')):
            annotation.slice.elements[-1] = f"'{shape}'"
    for part in annotation.iterate(flat=False):  # a name yields itself
        if part is not annotation:
            quote_shapes(part)
