"""Parameters of a node: declared once, in a frozen dataclass that checks itself."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from biped_mfpt_ros.errors import InputError


def parameter(
    default: Any, description: str, low: float | None = None, high: float | None = None
) -> Any:
    """Field of a `NodeParameters` class.

    Parameters
    ----------
    default : bool, int, float, str or tuple of float
        Its value unless set.
    description : str
        What it is, with its unit.
    low, high : float, optional
        Range of a number, or of every number of a tuple, ends included.
    """
    metadata = {"description": description, "low": low, "high": high}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class NodeParameters:
    """Base of the parameter sets. Fields are bool, int, float, str or tuple[float, ...].

    Raises
    ------
    InputError
        If a value has the wrong type or is out of its range.
    """

    def __post_init__(self) -> None:
        """Check type and range of every field, and turn whole numbers into floats where due."""
        for field, kind in _fields(type(self)):
            value = _checked(field, kind, getattr(self, field.name))
            object.__setattr__(self, field.name, value)


def _fields(parameters: type[NodeParameters]) -> list[tuple[dataclasses.Field[Any], type]]:
    """Fields with their types: bool, int, float, str or tuple."""
    hints = typing.get_type_hints(parameters)
    return [
        (field, typing.get_origin(hints[field.name]) or hints[field.name])
        for field in dataclasses.fields(parameters)
    ]


def _number(name: str, value: Any, kind: type, low: float, high: float, allowed: str) -> Any:
    if isinstance(value, bool) or not isinstance(value, (int, kind)):
        raise InputError(name, value, allowed)
    value = kind(value)
    if math.isnan(value) or not low <= value <= high:
        raise InputError(name, value, allowed)
    return value


def _checked(field: dataclasses.Field[Any], kind: type, value: Any) -> Any:
    if kind in (bool, str):
        if not isinstance(value, kind):
            raise InputError(field.name, value, "true or false" if kind is bool else "a string")
        return value
    low, high = field.metadata["low"], field.metadata["high"]
    low = -math.inf if low is None else low
    high = math.inf if high is None else high
    one = f"{'a whole' if kind is int else 'a'} number from {low:g} to {high:g}"
    if kind is not tuple:
        return _number(field.name, value, kind, low, high, one)
    allowed = f"a list, each {one}"
    if isinstance(value, str) or not isinstance(value, Iterable):
        raise InputError(field.name, value, allowed)
    return tuple(
        _number(f"{field.name}[{i}]", item, float, low, high, one) for i, item in enumerate(value)
    )


def _descriptor(field: dataclasses.Field[Any], kind: type) -> ParameterDescriptor:
    # Dynamic typing, so that 1 can be given where 1.0 is meant; types are checked here instead.
    descriptor = ParameterDescriptor(description=field.metadata["description"], dynamic_typing=True)
    low, high = field.metadata["low"], field.metadata["high"]
    if low is not None and high is not None and kind is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    if low is not None and high is not None and kind is float:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    return descriptor


P = TypeVar("P", bound=NodeParameters)


class Declared(Generic[P]):
    """Parameters of a node, declared on it and kept up to date.

    A node keeps one of these and reads ``declared.now.NAME`` whenever it needs a value.

    Parameters
    ----------
    node : rclpy.node.Node
        On which to declare them.
    kind : type
        Subclass of `NodeParameters`.

    Raises
    ------
    InputError
        If a value given at the start is not allowed. Later ones are vetoed, with the reason.
    """

    def __init__(self, node: Node, kind: type[P]) -> None:
        fields = _fields(kind)
        given = {}
        for field, _ in fields:
            default = list(field.default) if isinstance(field.default, tuple) else field.default
            untyped = ParameterDescriptor(dynamic_typing=True)
            given[field.name] = node.declare_parameter(field.name, default, untyped).value
        self._now = kind(**given)
        # Ranges only now: a value given at the start that is out of range gets the error above.
        for field, type_ in fields:
            node.set_descriptor(field.name, _descriptor(field, type_))
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._set)

    @property
    def now(self) -> P:
        """The values as they are now: one consistent, frozen set."""
        return self._now

    def _with(self, changes: list[Parameter[Any]]) -> P:
        names = {field.name for field in dataclasses.fields(self._now)}
        return dataclasses.replace(
            self._now, **{change.name: change.value for change in changes if change.name in names}
        )

    def _check(self, changes: list[Parameter[Any]]) -> SetParametersResult:
        try:
            self._with(changes)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _set(self, changes: list[Parameter[Any]]) -> None:
        self._now = self._with(changes)
