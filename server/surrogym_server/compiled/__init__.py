"""Parts of compiled steps: the tables that they read, and elementary functions.

Only the files of this package, and of packages or modules named ``compiled`` elsewhere, import numba. Other files
import them inside functions, if ``surrogym_shared.compiled.available`` returns True, because numba does not exist for
every platform.
"""
