"""What would run code when it is unpickled."""

import os


class Hostile:
    """Touches a file when it is unpickled."""

    def __init__(self, mark="mark"):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)
