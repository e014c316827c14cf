"""How well a model predicts recorded traffic: errors (`eqrt eval`) and pictures (`eqrt plot`)."""
