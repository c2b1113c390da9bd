"""Visualisation: the 3D page in the browser, pictures and videos without a screen, annotator and object editor.

Open `page.py` first (`wearcap view`): it shows the layers of `page_layers.py` on one clock. `picture.py`
draws without a browser (`wearcap render`); `annotate*.py` serve the page on which contacts are marked
(`wearcap annotate`, `annotator/`), `object_editor*.py` the one on which objects are cut out of a scan (`wearcap scene
edit`). `guard.py` admits a page's own requests only; `page_text.py` escapes texts of files and devices.
"""
