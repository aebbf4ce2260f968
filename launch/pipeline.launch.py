"""The whole pipeline: simulators, one mesher, analysis, optimiser and, if wanted, a recorder.

ros2 launch biped_mfpt_ros pipeline.launch.py workers:=4
"""

import os

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = "biped_mfpt_ros"


def simulators(context: LaunchContext) -> list[Node]:
    """As many simulators as asked for. They choose their own names, so that none is used twice."""
    text = LaunchConfiguration("workers").perform(context)
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"workers: {text!r} is not allowed; allowed: a whole number from 1")
    return [
        Node(
            package=PACKAGE,
            executable="simulator",
            namespace=LaunchConfiguration("namespace"),
            output="screen",
        )
        for _ in range(int(text))
    ]


def generate_launch_description() -> LaunchDescription:
    namespace = LaunchConfiguration("namespace")
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
    ]
    recorder = Node(
        package=PACKAGE,
        executable="recorder",
        namespace=namespace,
        # Without its type a name such as 2024 would become a number.
        parameters=[{"bag": ParameterValue(LaunchConfiguration("bag"), value_type=str)}],
        condition=IfCondition(LaunchConfiguration("record")),
        output="screen",
    )
    others = [
        Node(package=PACKAGE, executable=name, namespace=namespace, output="screen")
        for name in ("mesher", "analysis", "optimiser")
    ]
    # The simulators first: an error there comes before anything runs.
    return LaunchDescription([*arguments, OpaqueFunction(function=simulators), recorder, *others])
