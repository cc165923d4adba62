"""Used by robot.py where it is given no robot: a seven-joint arm of boxes and cylinders, as URDF."""

from __future__ import annotations

import math
from pathlib import Path

REACH = 1.0  # metres, about
LIMITS = 2.8, 2.0, 2.8, 2.2, 2.8, 2.0, 2.9  # radians, on both sides


def link(name: str, length: float, width: float, color: str) -> str:
    """A bar along z with a bolt across, so that it looks the same from no two sides."""
    return f"""
  <link name="{name}">
    <visual><origin xyz="0 0 {length / 2}"/><geometry><box size="{width} {0.7 * width} {length}"/></geometry>
      <material name="{name}"><color rgba="{color} 1"/></material></visual>
    <visual><origin xyz="{0.5 * width} 0 {0.3 * length}" rpy="0 {math.pi / 2} 0"/>
      <geometry><cylinder radius="{0.3 * width}" length="{0.6 * width}"/></geometry></visual>
  </link>"""


def joint(number: int, parent: str, child: str, z: float, axis: str, limit: float) -> str:
    return f"""
  <joint name="joint_{number}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 {z}"/><axis xyz="{axis}"/>
    <limit lower="{-limit}" upper="{limit}" effort="1" velocity="1"/>
  </joint>"""


def write(path: Path) -> Path:
    lengths = 0.18, 0.2, 0.2, 0.2, 0.16, 0.12, 0.1, 0.08
    axes = "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1"
    parts = [link("base", lengths[0], 0.16, "0.3 0.3 0.35")]
    for k, (axis, limit) in enumerate(zip(axes, LIMITS, strict=True), 1):
        shade = "0.8 0.4 0.1" if k % 2 else "0.85 0.85 0.8"
        parts.append(link(f"link_{k}", lengths[k], 0.13 - 0.01 * k, shade))
        parts.append(joint(k, "base" if k == 1 else f"link_{k - 1}", f"link_{k}", lengths[k - 1], axis, limit))
    path.write_text(f'<?xml version="1.0"?>\n<robot name="arm">{"".join(parts)}\n</robot>\n', encoding="utf-8")
    return path
