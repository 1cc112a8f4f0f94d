"""`load`: whatever can be loaded, by name or path."""

from __future__ import annotations

import os

from solidgrain.runtime.bundle import bundle_folder, is_texture_file, open_bundle
from solidgrain.runtime.space import Space, load_space
from solidgrain.runtime.texture import DEFAULT_TEXTURE, Texture, check_alone, load_texture


def load(
    source: str | os.PathLike[str] = DEFAULT_TEXTURE,
    *,
    bundle: str | os.PathLike[str] | None = None,
    provider: str = "auto",
    precision: str = "float32",
    threads: int = 0,
) -> Texture | Space:
    """A texture, or a space where `source` is a bundle with an encoder. Arguments and errors as in `load_texture`.

    Typed code that knows which it is calls `load_texture` or `load_space`.
    """
    name = os.fspath(source)
    if not is_texture_file(name) and open_bundle(bundle_folder(name)).is_space:
        check_alone(name, bundle)
        return load_space(source, provider=provider, precision=precision, threads=threads)
    return load_texture(source, bundle=bundle, provider=provider, precision=precision, threads=threads)
