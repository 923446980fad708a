"""Check what a reader sees in a scene, and whether its cameras fit its images.

python -m asysplat.data.check PATH
"""

from asysplat.data.check.report import Report, Verdict, check_scene

__all__ = ["Report", "Verdict", "check_scene"]
