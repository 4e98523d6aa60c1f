"""Clutter scale: one number for the difficulty of a scene, and for the clutter that a policy can handle.

`features` describes a scene by numbers, `item_response` fits their weights to the results of several policies, and
`curves` fits the success of one policy against the difficulty.
"""
