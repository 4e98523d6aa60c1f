"""What the stages of an episode are called on the page."""

from __future__ import annotations

STAGES = {
    "furniture_opened": "furniture opened",
    "reached_any": "an object touched (RA)",
    "picked_any": "an object picked (PA)",
    "obstacles_cleared": "obstacles cleared (CO)",
    "reached_target": "target touched (RR)",
    "target_grasped": "target grasped",
    "target_lifted": "target lifted",
    "target_in_basket": "target in basket",
    "success": "success",
}
"""Of the funnels, in the order in which they are usually come to."""
FAILURES = {
    **{stage: said.split(" (")[0] for stage, said in STAGES.items() if stage != "success"},
    "placed": "placed, at rest",
    "error": "broken off",
}
"""What an episode did not come to (`outcomes.failure_stage`)."""
