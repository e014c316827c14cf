BprobabilitiesJk
k>ZSd>#¥Q>4Á&>ˆÚô=i:w=