"""Value types of the interfaces (``values``) and their conversion to and from messages
(``codec``).

The codec works with any message classes that carry the fields of the ROS interfaces: those of
``rclpy`` in a node, those of
``rosbags`` offline. Live and offline runs therefore write and read the same bytes.
"""
