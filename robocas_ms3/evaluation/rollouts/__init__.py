"""Episodes of a policy in the environments of a protocol.

`session` runs the episodes of an evaluation in groups, `rollout` one group. `action_wrapper` executes and records the
actions.
"""
