"""The report: a run's folder in, one HTML page out.

:mod:`page` puts it together; :mod:`content` has its figures and texts, :mod:`images` its pictures,
:mod:`surface` what it draws in 3D.
"""

from polysft_mi import lazy

__getattr__, __dir__, __all__ = lazy.attach(__name__, submod_attrs={"page": ["write_report"]})
