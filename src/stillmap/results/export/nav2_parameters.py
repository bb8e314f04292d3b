"""`nav2_params.yaml`: the parameters with which nav2 serves a map and the masks of its filters."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import yaml

from stillmap.core.errors import InputError
from stillmap.results.export.zones import SpeedLimit

PARAMETERS = "nav2_params.yaml"

# of nav2_msgs/CostmapFilterInfo
_KEEPOUT, _SPEED_PERCENT, _SPEED_ABSOLUTE = 0, 1, 2
_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)  # m/s of a value of the mask

_COMMENT = """\
# Parameters of nav2 for the map and the masks in this folder: merge them into yours.
# The names of files are relative: give full paths, or start the servers in this folder.
"""


class MaskCode(NamedTuple):
    """The meaning of values in a mask: base + multiplier * value; of speed limits 0 is none.

    Attributes:
        type: of nav2_msgs/CostmapFilterInfo.
        base: of speed limits in percent or m/s.
        multiplier: likewise.
    """

    type: int
    base: float
    multiplier: float

    @classmethod
    def of(cls, limits: Mapping[str, SpeedLimit]) -> Self:
        """The code for speed limits, by their origin for messages.

        Raises:
            InputError: some are in percent, others in m/s.
        """
        is_percent = all(limit.is_percent for limit in limits.values())
        if is_percent:
            return cls(_SPEED_PERCENT, 100.0, -1.0)
        for where, limit in limits.items():
            if limit.is_percent:
                what = "has a speed limit in percent, others are in m/s: a mask holds one of them"
                raise InputError(what, where=where, hint="write all as '50%', or all in m/s")
        fastest = max(limit.value for limit in limits.values())
        return cls(_SPEED_ABSOLUTE, 0.0, next(s for s in _STEPS if fastest <= 100 * s + 1e-9))

    def encode(self, limit: SpeedLimit, where: str) -> int:
        """The value, 0 to 100, of a limit, rounded down to what the mask can hold.

        Raises:
            InputError: it is below one step of the mask.
        """
        if limit.is_percent:
            return 100 - math.floor(limit.value)
        value = math.floor(limit.value / self.multiplier + 1e-9)
        if value < 1:
            what = f"a limit of {limit.value:g} m/s is less than a step of the mask"
            hint = f"steps are {self.multiplier:g} m/s, by the fastest of the limits"
            raise InputError(what, where=where, hint=hint)
        return value


NO_LIMITS = MaskCode.of({})


def write(path: Path, keepout: bool, speed: MaskCode | None) -> None:
    """Write the parameters of the servers, and of the filters of both costmaps.

    Args:
        path: the file.
        keepout: whether there is a keep-out mask.
        speed: the code of the speed mask; None where there is none.
    """
    content: dict[str, Any] = {"map_server": _node(yaml_filename="map.yaml")}
    filters: dict[str, dict[str, Any]] = {}
    nodes: list[str] = []
    masks = {"keepout": MaskCode(_KEEPOUT, 0.0, 1.0)} if keepout else {}
    if speed is not None:
        masks["speed"] = speed
    for name, (kind, base, multiplier) in masks.items():
        # absolute: the servers and the costmaps live in different namespaces
        info, mask = f"/{name}_costmap_filter_info", f"/{name}_filter_mask"
        server = f"{name}_filter_mask_server"
        content[server] = _node(yaml_filename=f"{name}.yaml", topic_name=mask, frame_id="map")
        content[info[1:] + "_server"] = _node(
            type=kind, filter_info_topic=info, mask_topic=mask, base=base, multiplier=multiplier
        )
        nodes += [server, info[1:] + "_server"]
        plugin = f"nav2_costmap_2d::{name.capitalize()}Filter"
        filters[f"{name}_filter"] = {"plugin": plugin, "enabled": True, "filter_info_topic": info}
    if "speed_filter" in filters:
        filters["speed_filter"]["speed_limit_topic"] = "/speed_limit"
    if nodes:
        content["lifecycle_manager_costmap_filters"] = _node(autostart=True, node_names=nodes)
        content["global_costmap"] = {"global_costmap": _costmap(filters)}
        # one costmap publishes the limits
        local = {name: one for name, one in filters.items() if name != "speed_filter"}
        if local:
            content["local_costmap"] = {"local_costmap": _costmap(local)}
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=False)
    path.write_text(_COMMENT + text, encoding="utf-8")


def _node(**parameters: Any) -> dict[str, Any]:
    return {"ros__parameters": parameters}


def _costmap(filters: dict[str, dict[str, Any]]) -> dict[str, Any]:
    # copies: ROS does not read the aliases that YAML has for what occurs twice
    return _node(filters=list(filters), **{name: dict(one) for name, one in filters.items()})
