"""Check a scene's files, and whether its cameras fit its images.

python -m asysplat.data.check PATH
"""
