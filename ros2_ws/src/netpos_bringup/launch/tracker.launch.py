"""Start the tracker alone, for your own RSUs: ``ros2 launch netpos_bringup tracker.launch.py``.

``params:=FILE`` is what ``netpos params --dump FILE`` writes; with ``bag:=DIR`` all that is heard
is recorded; ``namespace:=site_a`` puts both into a namespace. scripts/run_tracker.sh starts the
same nodes, which ``netpos.scenario.graph`` names, with `ros2 run` alone.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from netpos.scenario.graph import tracker_of


def _nodes(context):
    params, bag, namespace = (
        LaunchConfiguration(name).perform(context) for name in ("params", "bag", "namespace")
    )
    return [
        Node(
            package=node.package,
            executable=node.executable,
            name=node.name,
            namespace=namespace,
            arguments=list(node.arguments),
            parameters=[node.params_file] if node.params_file else [],
        )
        for node in tracker_of(params, bag)
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe tracker and recorder; Ctrl-C ends both."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value="", description="file of parameters"),
            DeclareLaunchArgument(
                "bag", default_value="", description="folder of a new recording"
            ),
            DeclareLaunchArgument("namespace", default_value="", description="of both nodes"),
            OpaqueFunction(function=_nodes),
        ]
    )
