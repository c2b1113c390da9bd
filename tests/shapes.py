"""The checker of annotations: beartype, with an int allowed where a float is asked for, as Python's typing has it."""

from beartype import BeartypeConf, beartype

checker = beartype(conf=BeartypeConf(is_pep484_tower=True))
