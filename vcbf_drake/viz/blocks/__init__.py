"""Block drawings of anything with named ports: sheets, their layout, their DOT.

`sheet` says what is drawn, `size` how large it is, `routing` where everything goes for
given choices, `search` which choices are good, `layout` is the outcome, `label` and
`dot` write it down.
"""

from vcbf_drake.viz.blocks.dot import sheet_dot, write_dot
from vcbf_drake.viz.blocks.sheet import Block, BlockSheet, Pin, Place, Wire

__all__ = ["Block", "BlockSheet", "Pin", "Place", "Wire", "sheet_dot", "write_dot"]
