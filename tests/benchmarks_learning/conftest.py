import sys
from pathlib import Path

# The benchmarks are not part of the installed package. Appended: the package itself is still the installed one.
sys.path.append(str(Path(__file__).parents[2] / "benchmarks" / "learning"))
