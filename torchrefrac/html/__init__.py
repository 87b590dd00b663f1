"""report.html: what a run or a sweep found, as one page that needs nothing but a browser."""

from torchrefrac.html.paper_page import write_paper
from torchrefrac.html.run_page import write_report
from torchrefrac.html.sweep_page import write_job_reports, write_sweep_report

__all__ = ["write_job_reports", "write_paper", "write_report", "write_sweep_report"]
