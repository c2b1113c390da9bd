"""The annotator (`wearcap annotate`): contacts of the hands, marked on a page beside the video (thesis §5.4.1).

`takes.py` says what of a recording is shown and keeps its labels, `server.py` serves the page in `page/`.
"""
