"""What is measured, and on what: the paper's comparisons as protocols (paper, 'Quantitative Evaluations')."""
