"""What a reader sees in a scene, and whether its cameras fit its images:
python -m asysplat.data.check PATH
"""

from asysplat.data.check.report import Report, check_scene
from asysplat.data.check.verdict import Verdict

__all__ = ["Report", "Verdict", "check_scene"]
