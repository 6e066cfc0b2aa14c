"""Seeing what a run learned, and choosing: reports for the browser, films and strobe pictures."""
