"""Robots: descriptions, generated URDF files, ManiSkill agents and controllers; importing it does not import SAPIEN."""
