"""One file per resource; `create_app(settings)` in app.py puts them together."""
