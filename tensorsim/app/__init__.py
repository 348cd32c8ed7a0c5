"""The app: a simulation in the browser. Needs gradio: ``pip install "tensorsim[app]"``."""
