"""ROS messages as IDL types of Cyclone DDS: another stack than that of rclpy.

Written after the definitions in common_interfaces; names are those that ROS 2 gives on the wire.
"""

from dataclasses import dataclass, field
from types import new_class

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl_types

# package, message: kind and name of each field
_DEFINITIONS = """
builtin_interfaces Time: int32 sec, uint32 nanosec
builtin_interfaces Duration: int32 sec, uint32 nanosec
std_msgs Header: Time stamp, string frame_id
std_msgs ColorRGBA: float32 r, float32 g, float32 b, float32 a
geometry_msgs Point: float64 x, float64 y, float64 z
geometry_msgs Vector3: float64 x, float64 y, float64 z
geometry_msgs Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs Pose: Point position, Quaternion orientation
geometry_msgs PoseArray: Header header, Pose[] poses
geometry_msgs Twist: Vector3 linear, Vector3 angular
geometry_msgs PoseWithCovariance: Pose pose, float64[36] covariance
geometry_msgs TwistWithCovariance: Twist twist, float64[36] covariance
geometry_msgs PoseWithCovarianceStamped: Header header, PoseWithCovariance pose
geometry_msgs Transform: Vector3 translation, Quaternion rotation
geometry_msgs TransformStamped: Header header, string child_frame_id, Transform transform
tf2_msgs TFMessage: TransformStamped[] transforms
nav_msgs Odometry: Header header, string child_frame_id, PoseWithCovariance pose,
 TwistWithCovariance twist
nav_msgs MapMetaData: Time map_load_time, float32 resolution, uint32 width, uint32 height,
 Pose origin
nav_msgs OccupancyGrid: Header header, MapMetaData info, int8[] data
map_msgs OccupancyGridUpdate: Header header, int32 x, int32 y, uint32 width, uint32 height,
 int8[] data
sensor_msgs LaserScan: Header header, float32 angle_min, float32 angle_max,
 float32 angle_increment, float32 time_increment, float32 scan_time, float32 range_min,
 float32 range_max, float32[] ranges, float32[] intensities
sensor_msgs PointField: string name, uint32 offset, uint8 datatype, uint32 count
sensor_msgs PointCloud2: Header header, uint32 height, uint32 width, PointField[] fields,
 bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense
sensor_msgs CompressedImage: Header header, string format, uint8[] data
visualization_msgs UVCoordinate: float32 u, float32 v
visualization_msgs MeshFile: string filename, uint8[] data
visualization_msgs Marker: Header header, string ns, int32 id, int32 type, int32 action,
 Pose pose, Vector3 scale, ColorRGBA color, Duration lifetime, bool frame_locked,
 Point[] points, ColorRGBA[] colors, string texture_resource, CompressedImage texture,
 UVCoordinate[] uv_coordinates, string text, string mesh_resource, MeshFile mesh_file,
 bool mesh_use_embedded_materials
visualization_msgs MarkerArray: Marker[] markers
diagnostic_msgs KeyValue: string key, string value
diagnostic_msgs DiagnosticStatus: byte level, string name, string message, string hardware_id,
 KeyValue[] values
diagnostic_msgs DiagnosticArray: Header header, DiagnosticStatus[] status
"""
_PLAIN = {"string": (str, ""), "bool": (bool, False), "byte": (idl_types.byte, 0)}
for _name in ("int8", "uint8", "int32", "uint32", "float32", "float64"):
    _PLAIN[_name] = getattr(idl_types, _name), 0.0 if _name.startswith("float") else 0


def _field(text):
    """Type and default of a field: zero, an empty list, or a whole message."""
    kind, _, length = text.rstrip("]").partition("[")
    element, default = _PLAIN.get(kind) or (globals()[kind], field(default_factory=globals()[kind]))
    if length:
        n = int(length)
        return idl_types.array[element, n], field(default_factory=lambda: [default] * n)
    if text.endswith("]"):
        return idl_types.sequence[element], field(default_factory=list)
    return element, default


def _define(package, name, fields):
    made = {of: _field(kind) for kind, of in map(str.split, fields.split(","))}
    body = {of: default for of, (_, default) in made.items()}
    body["__annotations__"] = {of: kind for of, (kind, _) in made.items()}
    body["__module__"] = __name__
    wire = {"typename": f"{package}::msg::dds_::{name}_"}
    globals()[name] = dataclass(new_class(name, (IdlStruct,), wire, lambda ns: ns.update(body)))


for _line in _DEFINITIONS.replace(",\n", ",").strip().split("\n"):
    _head, _, _fields = _line.partition(":")
    _define(*_head.split(), _fields)
