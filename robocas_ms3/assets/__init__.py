"""Asset packs: folders of simulation-ready, grasp-annotated objects and furniture."""
