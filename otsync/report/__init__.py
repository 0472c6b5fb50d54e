"""The report page: one self-contained HTML file that says what was found, how sure it is, and what to do next."""

from .page import write_report

__all__ = ["write_report"]
