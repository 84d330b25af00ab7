"""The report of one or more runs: one self-contained HTML page."""

from lunar_fg.report.page import write_report

__all__ = ["write_report"]
