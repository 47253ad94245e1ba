"""What users call says the types of what it takes and gives."""

import importlib
import inspect

import pytest

PACKAGES = ("polysft_mi", "polyfit", "onefit")


def untyped(function):
    """Names of the parameters, and ``return``, that have no annotation."""
    signature = inspect.signature(function)
    names = [
        p.name
        for p in signature.parameters.values()
        if p.annotation is p.empty and p.name not in ("self", "cls")
    ]
    return names + ["return"] * (signature.return_annotation is signature.empty)


def callables(name, value):
    """Dotted name and function of what a public name lets one call."""
    if inspect.isfunction(value):
        yield name, value
    if inspect.isclass(value):
        for own, member in vars(value).items():
            member = getattr(member, "__func__", getattr(member, "fget", member))
            member = getattr(member, "func", member)  # cached properties
            if inspect.isfunction(member) and not own.startswith("_"):
                yield f"{name}.{own}", inspect.unwrap(member)


@pytest.mark.parametrize("package", PACKAGES)
def test_public_functions_are_typed(package):
    module = importlib.import_module(package)
    found = {
        name: missing
        for public in module.__all__
        for name, function in callables(public, getattr(module, public))
        if (missing := untyped(function))
    }
    assert found == {}
