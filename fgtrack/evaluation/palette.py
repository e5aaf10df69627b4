"""The colours of figures and viewers."""

#: Colours of Okabe and Ito, which the colour-blind can distinguish as well.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
