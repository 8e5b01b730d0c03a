"""Damage of a database: the errors of drivers that indicate it, and the message."""

from __future__ import annotations

import re
import sqlite3

import sqlalchemy as sa

from surrogym_server.errors import Damaged

SQLITE_CODES = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
SQLSTATES = ("XX001", "XX002", "42P01", "42703")  # data and index corrupted, undefined table and column
OTHER_SCHEMA = re.compile(r"no such (table|column)|has no column|already exists")  # SQLite has no code for these
UNDECODABLE = "Could not decode to UTF-8"  # Python's driver has no error class for this


def damaged(reason: object) -> Damaged:
    """The error for stored data that this program can't have written."""
    return Damaged(f"the database is damaged: {reason}")


def means_damage(error: sa.exc.DBAPIError) -> bool:
    """Whether an error of the driver means that stored data can't be read, or that the tables differ."""
    if getattr(error.orig, "sqlstate", None) in SQLSTATES:
        return True
    message = str(error.orig)
    return are_broken_pages(error) or UNDECODABLE in message or OTHER_SCHEMA.search(message) is not None


def are_broken_pages(error: sa.exc.DBAPIError) -> bool:
    """Whether an error of the driver means that a file's structure is broken, which can't be repaired while
    it is open."""
    return getattr(error.orig, "sqlite_errorcode", 0) & 0xFF in SQLITE_CODES
