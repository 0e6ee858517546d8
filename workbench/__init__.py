"""A workbench for the control of flexible structures.

structure → modes → rig → law → response → work → placement        design
record    → modes → structure                                       identification: the same types, backwards
rig + records → gap → effects → a better rig                        diagnosis
"""
