BprobabilitiesJ$
k>oSd>x•Q>ª¿&>ø€Ù=g9w=