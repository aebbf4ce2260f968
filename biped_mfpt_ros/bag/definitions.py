"""Message definitions as a bag carries them: the text, and the text of all it is made of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from biped_mfpt_ros.errors import InputError

_SEPARATOR = "=" * 80


def message_definition(type_name: str) -> str:
    """Definition of a message type, followed by those of all types in its fields, recursively.

    This is the text of a schema of encoding ``ros2msg``: each further definition comes after a
    line of 80 equals signs and a line ``MSG: PACKAGE/NAME``, each once, depth first, the fields'
    types in alphabetical order.

    Parameters
    ----------
    type_name : str
        Such as ``biped_mfpt_msgs/msg/MeshInfo``. Its package has to be installed.

    Returns
    -------
    str

    Raises
    ------
    InputError
        The package or its definition is not installed, or is not a message's.
    """
    seen = {type_name}

    def with_dependencies(name: str) -> list[str]:
        text = _definition_file(name).read_text(encoding="utf-8")
        parts = [text]
        for dependency in sorted(_dependencies(text, name)):
            if dependency not in seen:
                seen.add(dependency)
                package, _, short = dependency.split("/")
                first, *further = with_dependencies(dependency)
                parts += [f"{_SEPARATOR}\nMSG: {package}/{short}\n{first}", *further]
        return parts

    return "\n".join(with_dependencies(type_name))


def _definition_file(type_name: str) -> Path:
    allowed = "a message type of an installed package, as PACKAGE/msg/NAME"
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg":
        raise InputError("message type", type_name, allowed)
    try:
        path = Path(get_package_share_directory(parts[0]), "msg", f"{parts[2]}.msg")
    except (PackageNotFoundError, ValueError):
        raise InputError("message type", type_name, allowed) from None
    if not path.is_file():
        raise InputError("message type", type_name, allowed)
    return path


def _dependencies(text: str, type_name: str) -> set[str]:
    def named(field_type: Any) -> str | None:
        kind, of = field_type
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return named(of[0])
        return of if kind == Nodetype.NAME else None

    _, fields = get_types_from_msg(text, type_name)[type_name]
    return {name for _, field_type in fields if (name := named(field_type)) is not None}
