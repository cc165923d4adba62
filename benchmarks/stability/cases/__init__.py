"""The cases of the stability report."""

from . import bounced, camera, coincident, geometry, light, scale, stiff
from .case import Case

CASES: dict[str, Case] = {
    case.name: case
    for module in (scale, camera, geometry, coincident, stiff, light, bounced)
    for case in module.group.cases
}
