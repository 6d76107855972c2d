# Made of asynchronous/__init__.py by `make client`: change that one.
