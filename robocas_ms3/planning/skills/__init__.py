"""Skills of the scripted policies: functions of an `Arm` that plan and run motions.

A skill raises ``PlanningFailed`` with its stage and a reason where it can't be done, and ``EpisodeLost`` where the
episode can't succeed any more. All poses are in the arm's base frame, lengths in m. ``slot`` numbers an object.
"""
