from .solver import AnchoredFGW
__all__=["AnchoredFGW"]
