BprobabilitiesJl¥r>†g>h8:>
=3>-ZÀ=ùc°=