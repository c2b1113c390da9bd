"""The object editor (`wearcap scene edit`): objects that move, cut out of a scan; `editor.py` cuts, `view.py` shows."""
