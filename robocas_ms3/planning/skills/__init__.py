"""Skills of the scripted policies: functions of an `Arm` that plan and run motions.

A skill raises ``PlanningError`` with its stage and a reason where it can't be done, and ``UnrecoverableError``
where the episode can't succeed any more. All poses are in the arm's base frame, lengths in m. ``slot`` is the index of
an object.
"""
