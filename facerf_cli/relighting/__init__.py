from typing import Literal

BalanceMode = Literal["keep", "neutral"]  # the photo's white balance, or coloured light neutralised
