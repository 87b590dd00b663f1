"""Work side by side: small batches on threads, long work in many parts by other processes or machines."""

from torchrefrac.parallel.threads import side_by_side
from torchrefrac.parallel.workers import ExecutorError, ExecutorOptions, Workers

__all__ = ["ExecutorError", "ExecutorOptions", "Workers", "side_by_side"]
