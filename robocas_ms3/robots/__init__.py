"""The robot: URDF generation, the ManiSkill agent, its controllers. Importing this package alone imports no SAPIEN."""
