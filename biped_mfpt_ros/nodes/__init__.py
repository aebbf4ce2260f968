"""The ROS 2 nodes: they convert messages, call the core, and publish what comes out.

One node to a file, with its ``main``. Beside them stands what they share: `messages` (numpy arrays
to messages and back), `assembly` (a mesh from its messages), `fan_out` (chunks of swings over the
simulators), none of which imports rclpy; and `qos`, `parameters`, `spin`.
"""
