"""The ROS 2 node of `stillmap live`; rclpy and messages come from the user's own installation."""
