"""The files of LLVM 15, on which Dr.Jit must not run, where they are installed."""

from polyfit import backend

OLD_LLVM = [
    path
    for path in backend._libraries(backend._search_folders())
    if (backend._named_version(path) or (0,))[0] == 15
]
