"""Start the tracker alone, for your own RSUs: ``ros2 launch netpos_bringup tracker.launch.py``.

``params:=FILE`` is what ``netpos params --dump FILE`` writes; with ``bag:=DIR`` all that is heard
is recorded. scripts/run_tracker.sh does the same with `ros2 run` alone.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node


def _tracker(context):
    file = LaunchConfiguration("params").perform(context)
    return [
        Node(package="ekf_tracker", executable="ekf_tracker", parameters=[file] if file else [])
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe tracker and recorder; Ctrl-C ends both."""
    bag = LaunchConfiguration("bag")
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value="", description="file of parameters"),
            DeclareLaunchArgument(
                "bag", default_value="", description="folder of a new recording"
            ),
            Node(
                package="netpos_bag",
                executable="record",
                arguments=["--output", bag],
                condition=IfCondition(PythonExpression(["'", bag, "' != ''"])),
            ),
            OpaqueFunction(function=_tracker),
        ]
    )
