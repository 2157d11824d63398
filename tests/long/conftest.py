"""Scripts are run in processes of their own: pytest must not load them for doctests, because some change the environment."""

from pathlib import Path

collect_ignore = [path.name for path in Path(__file__).parent.glob("*.py") if not path.name.startswith("test_")]
