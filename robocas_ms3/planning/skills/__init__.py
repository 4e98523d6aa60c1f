"""Skills of the scripted policies: functions of an `Arm` that plan and run motions.

A skill raises ``PlanningError`` with a stage and a reason if it fails, and ``UnrecoverableError`` if the episode cannot
succeed any more. Poses are in the arm's base frame, lengths in m. ``slot`` is the index of an object.
"""
