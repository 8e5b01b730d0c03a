"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): files with native code, which runs in a process of its
own.

``adapter`` opens a unit by its name, ``archive`` reads the declarations of its file, and ``choices`` the settings of a
person. ``host`` is the program that loads the native code, ``instance`` makes the calls of both FMI versions, and
``process`` starts the host and sends it requests.
"""
