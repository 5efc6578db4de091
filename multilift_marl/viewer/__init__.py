"""Watch a team in the browser, `python -m multilift_marl.view`; the page is served to this machine alone."""
