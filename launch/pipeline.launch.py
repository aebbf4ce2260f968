"""The whole pipeline: simulators, one mesher, analysis, optimiser and, if wanted, a recorder.

ros2 launch biped_mfpt_ros pipeline.launch.py workers:=4
"""

import os
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "biped_mfpt_ros"


def nodes(context: LaunchContext) -> list[Node]:
    """All nodes, the simulators first: an error there comes before anything runs."""
    value = {
        name: LaunchConfiguration(name).perform(context)
        for name in ("workers", "record", "bag", "namespace", "params_file")
    }
    workers = value["workers"]
    if not workers.isdecimal() or int(workers) < 1:
        raise ValueError(f"workers: {workers!r} is not allowed; allowed: a whole number from 1")
    parameters: list[Any] = [value["params_file"]] if value["params_file"] else []
    # Without its type a name such as 2024 would become a number.
    bag = [{"bag": ParameterValue(value["bag"], value_type=str)}] if value["bag"] else []
    # Simulators choose their own names, so that none is used twice.
    names = ["simulator"] * int(workers) + ["mesher", "analysis", "optimiser"]
    if value["record"] == "true":
        names.append("recorder")
    return [
        Node(
            package=PACKAGE,
            executable=name,
            namespace=value["namespace"],
            parameters=parameters + bag if name == "recorder" else parameters,
            output="screen",
        )
        for name in names
    ]


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(
            "workers",
            default_value=str(len(os.sched_getaffinity(0))),
            description="number of simulators; unless given, one for each core",
        ),
        DeclareLaunchArgument(
            "record",
            default_value="true",
            choices=["true", "false"],
            description="whether to record the topics of the pipeline to a bag",
        ),
        DeclareLaunchArgument(
            "bag",
            default_value="",
            description="directory of the bag, which must not exist yet; unless given, "
            "the recorder names one after the time",
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="namespace of all nodes; empty: none"
        ),
        DeclareLaunchArgument(
            "params_file",
            default_value="",
            description="YAML file with parameters of the nodes; empty: none",
        ),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes)])
