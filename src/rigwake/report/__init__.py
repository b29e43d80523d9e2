"""A report people can check: verdict, rig, uncertainty, residuals, pictures, in one HTML file."""

from rigwake.report.content import ReportContent, load_report_content
from rigwake.report.report_page import build_report
from rigwake.report.report_summary import summary_lines

__all__ = ["ReportContent", "build_report", "load_report_content", "summary_lines"]
