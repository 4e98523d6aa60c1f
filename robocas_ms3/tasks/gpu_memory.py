"""How much memory PhysX sets aside on a GPU, by how many envs there are and what is in them."""

from __future__ import annotations

from mani_skill.utils.structs.types import GPUMemoryConfig

# What one env has at most, counted on a CPU (4 seeds of each shipped configuration, the arm moving about): 25 contact
# points and 8 pairs of touching shapes for each object, the robot's and the basket's included. Twice that, since what
# falls from a hand or a heap that is stirred has more, and an engine that runs out of it drops contacts.
CONTACTS_PER_OBJECT, PATCHES_PER_OBJECT = 50, 16
CONTACTS_BESIDE, PATCHES_BESIDE = 100, 32  # of the robot, the furniture and the basket with each other
STACK_PER_PATCH, TEMPORARY_PER_CONTACT = 512, 64  # bytes, of the engine's own


def gpu_memory(num_envs: int, objects: int) -> GPUMemoryConfig:
    """Capacities that a number of envs needs; never less than ManiSkill's.

    Args:
        num_envs: N.
        objects: K in each.
    """
    least = GPUMemoryConfig()
    contacts = num_envs * (CONTACTS_PER_OBJECT * objects + CONTACTS_BESIDE)
    patches = num_envs * (PATCHES_PER_OBJECT * objects + PATCHES_BESIDE)
    return GPUMemoryConfig(
        temp_buffer_capacity=max(least.temp_buffer_capacity, _power_of_2(TEMPORARY_PER_CONTACT * contacts)),
        max_rigid_contact_count=max(least.max_rigid_contact_count, _power_of_2(contacts)),
        max_rigid_patch_count=max(least.max_rigid_patch_count, _power_of_2(patches)),
        collision_stack_size=max(least.collision_stack_size, _power_of_2(STACK_PER_PATCH * patches)),
    )


def _power_of_2(least: int) -> int:
    """The least power of 2 that is no less."""
    return 1 << (least - 1).bit_length()
