"""ROS bags: reading recordings, writing recordings and results."""
