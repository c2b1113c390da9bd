"""What every page and socket of the programs shares: who may ask (`guard.py`), how many and how fast (`connections.py`), the
3D page's server (`page_server.py`), and texts of files and devices, escaped (`page_text.py`).
"""
