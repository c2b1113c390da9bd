"""Visualisation: the 3D page in the browser, pictures and videos without a screen.

Open `page.py` first (`wearcap view`): it shows the layers of `page_layers.py` on one clock. `picture.py` draws without a
browser (`wearcap render`).
"""
