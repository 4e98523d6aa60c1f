"""A program that runs the made-up plan into a folder; its processes import none of what it needs itself."""

if __name__ == "__main__":
    import sys
    from pathlib import Path

    from plan_stages import run_here

    run_here(Path(sys.argv[1]), jobs=2)
