"""`--none-skipped`, for where all that is optional is installed: what would be skipped fails."""

import signal

import pytest


def pytest_configure():
    # A shell's background job has Ctrl-C ignored, and so have all that it starts.
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    parser.addoption("--none-skipped", action="store_true", help="a test that would be skipped fails")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if session.config.getoption("--none-skipped") and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter, config):
    skipped = terminalreporter.stats.get("skipped", ())
    if skipped and config.getoption("--none-skipped"):
        terminalreporter.section("none may be skipped", red=True)
        for report in skipped:
            terminalreporter.line(f"SKIPPED {report.nodeid}")
