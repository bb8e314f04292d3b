"""ROS bags written: of recordings and of what was found out about them."""

from stillmap.recording.ros.kinds import Kind
from stillmap.recording.ros_writing.bag import Bag, new_bag, require_stamps
from stillmap.recording.ros_writing.recordings import write

__all__ = ["Bag", "Kind", "new_bag", "require_stamps", "write"]
