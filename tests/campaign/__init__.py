"""The crash campaign: a small real job under seeded faults, held against an undisturbed run.

python -m tests.campaign --help
"""
