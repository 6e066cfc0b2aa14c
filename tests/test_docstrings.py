"""Every public name says what it does, and no docstring speaks of a parameter that is not there."""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import sb3_momba
from sb3_momba.policy import MombaPolicy

PACKAGE = Path(sb3_momba.__file__).parent
PUBLIC = {name: getattr(sb3_momba, name) for name in sb3_momba.__all__}
CLASSES = {name: one for name, one in PUBLIC.items() if inspect.isclass(one)}

Definition = ast.FunctionDef | ast.ClassDef


def is_ours(cls: type) -> bool:
    return cls.__module__.split(".")[0] == "sb3_momba"


def documented(docstring: str | None) -> set[str]:
    return set(re.findall(r":param \**(\w+):", docstring or ""))


def parameters(one: object) -> set[str]:
    return {name for name in inspect.signature(one).parameters if not name.startswith("_")}


def own_members(cls: type) -> Iterator[tuple[str, object]]:
    """Public methods and properties of a class and of its bases, as far as they are ours."""
    for base in filter(is_ours, cls.__mro__):
        for name, value in vars(base).items():
            function = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if not name.startswith("_") and (inspect.isfunction(function) or isinstance(function, property)):
                yield f"{base.__name__}.{name}", function


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_a_docstring(name):
    one = PUBLIC[name]
    assert is_ours(one)
    # What dataclass writes where there is none.
    assert one.__doc__
    assert not one.__doc__.startswith(f"{name}(")


@pytest.mark.parametrize("name", CLASSES)
def test_every_public_method_has_a_docstring_of_its_own(name):
    assert [member for member, function in own_members(CLASSES[name]) if not function.__doc__] == []


@pytest.mark.parametrize("name", PUBLIC)
def test_every_parameter_of_a_public_name_is_documented(name):
    one = PUBLIC[name]
    docstrings = [one.__doc__]
    if inspect.isclass(one) and issubclass(one, MombaPolicy):
        docstrings.append(MombaPolicy.__doc__)
    assert parameters(one) - set().union(*map(documented, docstrings)) == set()


def test_every_parameter_that_both_policies_share_is_documented():
    assert parameters(MombaPolicy) - documented(MombaPolicy.__doc__) == set()


def definitions(path: Path) -> Iterator[Definition]:
    return (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, Definition))


def names_taken(node: Definition) -> set[str]:
    """Of a function, or of a class's constructor: its __init__, or its annotated fields."""
    if isinstance(node, ast.FunctionDef):
        given = node.args
        every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
        return {argument.arg for argument in every if argument is not None}
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return names_taken(member)
    return {member.target.id for member in node.body if isinstance(member, ast.AnnAssign)}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_docstring_has_a_parameter_that_is_not_there(path):
    stale = {node.name: documented(ast.get_docstring(node)) - names_taken(node) for node in definitions(path)}
    assert {name: names for name, names in stale.items() if names} == {}


def test_every_public_function_of_the_hub_has_a_docstring():  # Read, not imported: huggingface_hub need not be there.
    functions = [node for node in definitions(PACKAGE / "hub.py") if not node.name.startswith("_")]
    assert len(functions) > 5
    assert [node.name for node in functions if not ast.get_docstring(node)] == []
