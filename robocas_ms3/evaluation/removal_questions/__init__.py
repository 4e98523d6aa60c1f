"""Questions about which object a robot has to remove first: a test of vision-language models without a simulator.

The true answers are the objects with which a shortest sequence of removals can start (`demos.difficulty`).
"""
