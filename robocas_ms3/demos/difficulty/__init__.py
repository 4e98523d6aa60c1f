"""Difficulty of scenes: visibility, free grasps and gaps of the target, and the smallest number of removals.

`removal_search` searches for removals in forked processes, `scene_difficulty` applies it to a scene, and
`difficulty_file` measures many seeds and stores the results.
"""
