"""Infer which effects a model lacks, where and since when: one linear mixed model of the windows."""
