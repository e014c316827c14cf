BprobabilitiesJ:ff>·L>
÷G>Ø‘!>íšæ=sƒá=