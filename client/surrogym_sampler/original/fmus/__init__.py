"""Functional Mock-up Units (FMI 2.0 and 3.0, co-simulation): files with native code, run in a process of their own.

``adapter`` opens a unit by its name, ``archive`` reads what a file declares, ``choices`` what a person sets, ``host``
is the program that loads the native code, ``instance`` the calls of both versions, and ``process`` the host as this
process sees it.
"""
