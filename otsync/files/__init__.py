"""Files that are whole or absent, results kept by the content of what they were made from, and one hash of contents."""

from .arrays import atomic_write, existing, read_json, read_npz, write_json, write_npz
from .cache import Cache

__all__ = ["Cache", "atomic_write", "existing", "read_json", "read_npz", "write_json", "write_npz"]
