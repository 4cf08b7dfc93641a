"""Types of the options of encodings and decoders as files state them: each part's `Options` is a struct of
these, against which a stored field's are checked before they size anything."""

from typing import Annotated, Literal

from msgspec import Meta

Activation = Literal["softplus", "exp", "relu"]
Exponent = Annotated[float, Meta(ge=-80, le=50)]
Limits = tuple[Exponent, Exponent]
"""Between which numbers are kept that are exponentiated."""
Rank = Annotated[int, Meta(ge=8, le=1024, multiple_of=8)]
Layers = Annotated[int, Meta(ge=1, le=16)]
Width = Annotated[int, Meta(ge=8, le=1024, multiple_of=8)]
"""Of a hidden layer."""
Numbers = Annotated[int, Meta(ge=1, le=512)]
Rows = Annotated[int, Meta(ge=1, le=1 << 24)]
"""Of a table whose rows are found by whole numbers, which float32 has all up to that."""
Coefficients = Literal[1, 4, 9, 16]
"""Of spherical harmonics."""
Frequencies = Annotated[int, Meta(ge=0, le=24)]
