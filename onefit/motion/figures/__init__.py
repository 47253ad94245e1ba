"""Generated motions: where pelvis, feet, trunk and arms of a figure are goes in, poses of 24 joints
come out.
"""
